"""The transport: sessions, access to keys, the router, the relay, and resending after a lost connection."""

"""The transport: sessions, who may use which key, the router, the relay, and what is sent again after a lost connection."""

"""What crosses the network: sessions, who may use which key, messages, and the router."""

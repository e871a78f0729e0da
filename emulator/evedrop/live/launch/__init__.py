"""The launcher: briefs, child processes, ports, certificates and shards of a live run."""

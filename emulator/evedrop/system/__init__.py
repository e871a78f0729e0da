"""Files, processes, threads, clocks, signals, ports and output: nothing of Evedrop's subject."""

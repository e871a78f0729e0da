"""How an eavesdropper learns A, Q and μ_d: its posterior and moments, with parameters of its own in every trial."""

"""What an eavesdropper does that knows neither A, Q nor μ_d: posterior and moments with parameters of its own in every trial."""

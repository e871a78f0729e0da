"""Many runs: comparisons, sweeps, and scenarios as tests."""

"""The paper's figures and numbers, and ours for comparison."""

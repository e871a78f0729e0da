"""The paper's figures and numbers, ours beside the paper's."""

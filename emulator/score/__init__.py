"""How well every receiver did: sums, verdicts, and the summary made of them."""

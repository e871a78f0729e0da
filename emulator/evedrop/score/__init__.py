"""How well every receiver did: sums, verdicts, and the summary that is made from them."""

"""Networks and losses: mathematics with no state of its own."""

"""Which terms and orders of a structure earn their place: candidates, what they predict, the choice in words."""

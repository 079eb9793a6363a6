"""The page of a league."""

"""The page about the autopsy of a record."""

"""The autopsy of a record: what ran, what is wrong, what it costs, and what would be better."""

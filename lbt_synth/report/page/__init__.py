"""Pages that people read: what is on them, and the files that they become."""

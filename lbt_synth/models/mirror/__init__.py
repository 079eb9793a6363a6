"""The mirror in its local position loop."""

"""The mirror: its local position loop, and its response at the frame rate."""

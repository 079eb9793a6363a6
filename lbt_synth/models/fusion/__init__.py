"""Several sensors beside the loop's own: what they read, when, and the plant that they make."""

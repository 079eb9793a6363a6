"""The page of sliders: what moves, what is computed at each move, and the server of the page."""

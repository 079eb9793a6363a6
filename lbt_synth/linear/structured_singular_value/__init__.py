"""The structured singular value: how much uncertainty in several places a system survives."""

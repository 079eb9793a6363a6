"""The report on designs side by side."""

"""The methods of synthesis in one table; nothing else knows their names."""

"""Safe files, tables, and processes.

Files are written whole or not at all, and arrays carry a digest of their contents. Nothing here
knows what the numbers mean.
"""

"""Contents of the pages that people read: designs, studies."""

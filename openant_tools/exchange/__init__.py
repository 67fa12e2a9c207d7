"""Other people's formats: runs and models read from theirs, and written to them."""

"""The append-only recording and run tables: reading, writing, repair, export."""

"""Flight folders: schema, readers and writers."""

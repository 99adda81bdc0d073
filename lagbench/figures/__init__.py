"""Pictures and films of data."""

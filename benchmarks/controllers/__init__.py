"""List all controllers, with one record for each."""

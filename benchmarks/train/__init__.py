"""Train the networks of the package."""

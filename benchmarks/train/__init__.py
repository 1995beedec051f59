"""Train the policies that come with the project."""

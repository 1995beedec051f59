"""Train the neural networks that come with the project."""

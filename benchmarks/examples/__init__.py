"""Short programs that use the environment with popular libraries."""

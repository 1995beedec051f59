"""Short programs that use the environment with what people use."""

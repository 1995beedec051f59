"""Model the plant: the arguments, the dynamics and the external signals."""

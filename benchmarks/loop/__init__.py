"""Hold the cases, the loop of controller and plant, its measures, and linear models."""

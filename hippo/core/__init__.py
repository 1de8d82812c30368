"""What every learner shares; it knows no environment and no configuration system."""

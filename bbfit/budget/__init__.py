"""What a result may cost, and the choice of how to spend it."""

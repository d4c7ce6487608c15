"""Drawing billboard clouds."""

"""Drawing billboard clouds: one meaning, several speeds."""

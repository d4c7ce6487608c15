"""Frame times of fields of trees, measured in programs."""

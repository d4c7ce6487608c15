"""The stages that runs, levels of detail, sweeps and comparisons consist of, and the record of what was done."""

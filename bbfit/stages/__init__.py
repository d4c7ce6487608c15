"""The stages of runs, levels of detail, sweeps and comparisons, and the record of finished stages."""

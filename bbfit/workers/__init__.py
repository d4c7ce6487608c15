"""Work on many trees, in processes on this machine or on a Ray cluster."""

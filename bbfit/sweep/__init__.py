"""Sweeps: every configuration of a grid for every tree, on the cores of one machine or on a Ray cluster."""

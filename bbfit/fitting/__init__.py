"""Fitting a billboard cloud to views."""

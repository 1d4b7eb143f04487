"""Adapters: one file for each framework."""

"""Helpers that all other packages use: argument checks, progress, result folders, and records in files."""

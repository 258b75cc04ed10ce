"""Differential operators: ``(surface, field) -> field``."""

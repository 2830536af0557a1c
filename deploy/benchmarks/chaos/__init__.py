"""Faults of every kind, one after another, at random: what becomes of tracking, and what is left behind."""

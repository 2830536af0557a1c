"""Bridges between a running pipeline and other systems."""

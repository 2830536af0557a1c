"""Retrieval: the training views that look most like a frame."""

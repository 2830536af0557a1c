"""What a run has achieved, for people and for programs."""

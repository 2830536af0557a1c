"""A recording's messages through the stages again, and how far what they say is from what was recorded."""

"""Where frames come from, and when each of them is sent."""

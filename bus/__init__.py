"""What goes over the wire, and how: messages, topics, codec, transport, the life of a process, recordings."""

"""What a pipeline says, in Foxglove's schemas: as files, and live over a WebSocket."""

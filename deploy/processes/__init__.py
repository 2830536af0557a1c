"""Running the graph as processes over Zenoh: started, watched, ended, and listened to."""

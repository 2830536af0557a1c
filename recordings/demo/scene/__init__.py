"""The demo scene: a tin robot on a desk, built and rendered with Blender's `bpy` from nothing but code."""

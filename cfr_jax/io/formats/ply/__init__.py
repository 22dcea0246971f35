"""PLY: clouds and meshes, in text or binary."""

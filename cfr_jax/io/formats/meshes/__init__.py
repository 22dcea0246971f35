"""Formats of meshes: OFF, OBJ, STL, and glTF."""

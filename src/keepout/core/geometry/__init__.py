"""Geometry: meshes in, exact distances and offset solids out."""

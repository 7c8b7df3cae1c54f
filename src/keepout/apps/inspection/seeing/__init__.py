"""What a camera can see of a mesh: patches of its surface, and sight lines that are proved to be clear."""

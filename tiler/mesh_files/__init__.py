"""The pieces of a mesh as VTK's files, and the mesh of all pieces."""

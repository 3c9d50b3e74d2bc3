//! Meshes of other methods against the true surface.

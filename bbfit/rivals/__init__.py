"""Methods to compare bbfit with: baked planes, simplified and compressed meshes, a learned mesh."""

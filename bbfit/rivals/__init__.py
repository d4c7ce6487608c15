"""Systems that bbfit is an alternative to, to be measured beside it: baked planes, simplified and compressed meshes, a learned mesh."""

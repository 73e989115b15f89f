"""Tables of other programs: markers, clouds, captured shapes, forces, paths of blades."""

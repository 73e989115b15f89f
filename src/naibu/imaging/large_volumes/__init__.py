"""Digital volume correlation of volumes larger than memory: solved coarsely in memory, then refined from sums over blocks of voxels."""

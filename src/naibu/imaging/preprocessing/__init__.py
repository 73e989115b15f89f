"""What precedes every measurement: pairs of volumes, filters, pyramids, resampling, masks, rigid registration."""

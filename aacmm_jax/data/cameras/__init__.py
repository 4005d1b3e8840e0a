"""Camera models, one file each: where points in a camera's frame appear in its image."""

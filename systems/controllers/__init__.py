"""Controllers: pose estimate in, drive command out."""

"""Where a camera was in a known map: an index of the map, the search for a view, and the path of a recording."""

"""Images on surfaces: a colour or grey value at each vertex."""

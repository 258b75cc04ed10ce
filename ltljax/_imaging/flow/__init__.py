"""Pictures of vector fields: streamlines and line integral convolution."""

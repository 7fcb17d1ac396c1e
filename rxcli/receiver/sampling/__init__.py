"""Quick sampling of strips whose place is known from the frame before: what tracked frames of a clip need."""

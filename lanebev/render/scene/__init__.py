"""What there is to see: sampled roads, surroundings, traffic, light."""

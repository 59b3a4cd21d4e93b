"""The content of scenes: sampled roads, surroundings, traffic, light."""

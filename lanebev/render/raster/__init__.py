"""How a camera sees it: rays, surfaces, light, sensor."""

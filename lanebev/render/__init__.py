"""The rendered road: textures, scene, camera, drive."""

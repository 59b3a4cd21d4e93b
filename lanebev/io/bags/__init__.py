"""Bags of ROS and MCAP files.

``source`` opens a bag, ``messages`` reads it, and ``images`` decodes the images of a topic.
"""

from lanebev.io.bags.source import BagSource, lens_fields, open_bag_source

__all__ = ["BagSource", "lens_fields", "open_bag_source"]

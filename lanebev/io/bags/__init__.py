"""Bags of ROS and MCAP files.

``source`` opens a bag, ``messages`` reads it, ``images`` decodes the images of a topic, and ``speeds`` reads
the vehicle's.
"""

from lanebev.io.bags.source import BagSource, lens_fields, open_bag_source
from lanebev.io.bags.speeds import bag_speeds

__all__ = ["BagSource", "bag_speeds", "lens_fields", "open_bag_source"]

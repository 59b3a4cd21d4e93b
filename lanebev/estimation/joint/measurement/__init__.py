"""The measurement model: residuals of a frame's segments, given the pose and the road.

``observations`` makes end points in pixels of segments, ``road_curve`` computes the middle line of the road,
``residuals`` the distances of end points from projected boundaries and their Jacobian, and ``robust`` the
weights of segments.
"""

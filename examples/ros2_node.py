"""Calibrate in ROS 2: images and a CameraInfo in, the camera's pose over the road out on /tf."""

import rclpy
from cv_bridge import CvBridge
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.wait_for_message import wait_for_message
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from tf2_ros import TransformBroadcaster

import lanebev
from lanebev.io.calibration_file import quaternion_xyzw, vehicle_from_camera


def on_image(message):
    stamp = message.header.stamp
    result = session(bridge.imgmsg_to_cv2(message, "bgr8"), stamp.sec + 1e-9 * stamp.nanosec)
    node.get_logger().info(f"{result.status.name} {'; '.join(result.reasons)}")
    if result.status == lanebev.Status.TRACKING:
        matrix = vehicle_from_camera(result.extrinsics)[0]  # x forward, y left, z up; origin on the road
        origin = Vector3(**dict(zip("xyz", matrix[:3, 3].tolist(), strict=True)))
        rotation = Quaternion(**dict(zip("xyzw", quaternion_xyzw(matrix), strict=True)))
        header = Header(stamp=stamp, frame_id="base_footprint")
        pose = Transform(translation=origin, rotation=rotation)
        publish(TransformStamped(header=header, child_frame_id=message.header.frame_id, transform=pose))


rclpy.init()
node = rclpy.create_node("lane_calibration")
newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # from any publisher
_, info = wait_for_message(CameraInfo, node, "camera_info", qos_profile=newest)
lens = {"distortion_model": info.distortion_model, "D": list(info.d), "K": list(info.k)}
session = lanebev.Session(lanebev.Camera.from_fields({"width": info.width, "height": info.height, **lens}))
bridge, publish = CvBridge(), TransformBroadcaster(node).sendTransform
subscription = node.create_subscription(Image, "image", on_image, newest)
rclpy.spin(node)

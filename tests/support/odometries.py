"""Messages of other odometries, as those of cameras publish them, from what is true."""

import numpy as np
from scipy.spatial.transform import Rotation

from scenematch.files.ros.messages import quaternion_xyzw


def odometry_message(maker, time_ns, angles_deg, enu_mps, *, yaw_deg=0.0, child="base_link", variances=None):
    """Of a vehicle with this attitude and velocity.

    Args:
        maker: of messages.
        time_ns: the stamp.
        angles_deg: roll, pitch and heading.
        enu_mps: (3,) velocity east, north, up.
        yaw_deg: by which the odometry's own world is turned, clockwise; nobody who listens knows it.
        child: of the twist; "odom", the frame of the pose, has the twist along that frame's axes.
        variances: (3,) of the twist; None states zeros.
    """
    roll_deg, pitch_deg, heading_deg = angles_deg
    own = quaternion_xyzw(roll_deg, pitch_deg, heading_deg - yaw_deg)
    along = Rotation.from_quat(quaternion_xyzw(*angles_deg)).inv().apply(enu_mps)
    if child == "odom":
        along = Rotation.from_quat(own).apply(along)
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = 0.0 if variances is None else variances
    make, zero = maker.make, maker.vector(0.0, 0.0, 0.0)
    twist = make("geometry_msgs/msg/Twist", linear=maker.vector(*along), angular=zero)
    orientation = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", own, strict=True)))
    place = make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
                 orientation=orientation)  # fmt: skip
    return make(
        "nav_msgs/msg/Odometry",
        header=maker.header(time_ns, "odom"),
        child_frame_id=child,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=np.zeros(36)),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance),
    )

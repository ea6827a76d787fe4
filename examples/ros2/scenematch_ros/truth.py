"""Publish the simulated vehicle's true state for bags: /truth/fix, /truth/imu, /truth/height_agl.

Reads nav_msgs/Odometry on /truth/odometry in a world whose x is east and y is north. Converts metres to degrees
like ArduPilot.
"""

import math
import sys
from contextlib import suppress

import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Float64

METRES_PER_DEGREE = 0.011131884502145034e7  # of ArduPilot's Location


def geodetic(north_m, east_m, lat_deg, lon_deg):
    """Latitude and longitude in degrees."""
    lat = lat_deg + north_m / METRES_PER_DEGREE
    middle = math.radians((lat + lat_deg) / 2.0)
    return lat, lon_deg + east_m / METRES_PER_DEGREE / math.cos(middle)


def main():
    """Publish until ROS ends it."""
    rclpy.init(args=sys.argv)
    node = rclpy.create_node("truth")
    lat_deg, lon_deg = map(float, node.declare_parameter("origin", "0,0").value.split(",")[:2])
    fix = node.create_publisher(NavSatFix, "/truth/fix", 10)
    imu = node.create_publisher(Imu, "/truth/imu", 10)
    height = node.create_publisher(Float64, "/truth/height_agl", 10)

    def heard(odometry):
        at = odometry.pose.pose.position
        lat, lon = geodetic(at.y, at.x, lat_deg, lon_deg)
        fix.publish(NavSatFix(header=odometry.header, latitude=lat, longitude=lon, altitude=math.nan))
        imu.publish(Imu(header=odometry.header, orientation=odometry.pose.pose.orientation))
        height.publish(Float64(data=at.z))

    node.create_subscription(Odometry, "/truth/odometry", heard, 50)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()

"""A node of ROS 2 that loads a camera by the client, and releases it. Its executor waits for nothing.

python examples/ros2/camera_node.py, beside camera_system.py.
"""

from __future__ import annotations

import rclpy  # pyright: ignore[reportMissingImports]

from rr_actors import ros2


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("looker")
    client = ros2.Client(node)
    camera = client.load("cameras/camera", "/dev/video0", lambda status: print(status.state))
    rclpy.spin_until_future_complete(node, camera.future, timeout_sec=60)
    camera.future.result()  # raises what has gone wrong
    print(f"loaded: {camera.response}", flush=True)
    rclpy.spin_until_future_complete(node, client.unload(camera), timeout_sec=60)
    print("released", flush=True)
    client.close()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()

"""KITTI: raw recordings and the odometry benchmark."""

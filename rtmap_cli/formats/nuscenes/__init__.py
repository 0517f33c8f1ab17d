"""nuScenes v1.0 folders and mmdetection3d info files."""

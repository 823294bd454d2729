"""Line features from images: the six steps of the paper, each in its module, and the pipeline that joins them.

Nothing here knows of ROS, recordings, files or the command line.
"""

from line_feature_node.core.blobs import BLOB_DTYPE
from line_feature_node.core.features import SEGMENT_DTYPE, end_points
from line_feature_node.core.parameters import Parameters
from line_feature_node.core.pipeline import STEPS, LineFeatureExtractor, Stages, extract, warm_up_all
from line_feature_node.core.profiles import PROFILES

__all__ = [
    'BLOB_DTYPE', 'PROFILES', 'SEGMENT_DTYPE', 'STEPS', 'LineFeatureExtractor', 'Parameters', 'Stages', 'end_points',
    'extract', 'warm_up_all',
]

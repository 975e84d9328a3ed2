# s2a-bench in a ROS 2 Jazzy workspace, over rclpy: the commands of docs/colcon.md. docs/containers.md
# Not built yet: no builder was available. A test lints this file and checks the syntax of its commands.
FROM ros:jazzy-ros-base
SHELL ["/bin/bash", "-eo", "pipefail", "-c"]
WORKDIR /ws
COPY . src/s2a-bench
# the versions of ROS's packages are those of the image's day
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv ros-jazzy-rmw-cyclonedds-cpp \
    && rosdep update && rosdep install --from-paths src --ignore-src -y && rm -rf /var/lib/apt/lists/*
# NumPy 1, for which ROS's message modules are compiled; colcon's build of s2a-bench is the one that is used
RUN python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE && . venv/bin/activate \
    && pip install --no-cache-dir -c src/s2a-bench/constraints-ros-jazzy.txt src/s2a-bench \
    && pip uninstall -y s2a-bench \
    && source /opt/ros/jazzy/setup.bash && python -m colcon build
RUN printf '%s\n' 'source /ws/install/setup.bash' 'source /ws/venv/bin/activate' \
    'exec /ws/install/s2a_bench/lib/s2a_bench/s2a-bench "$@"' > /ws/run.bash \
    && useradd --create-home --uid 1001 s2a && install --directory --owner s2a /work
ENV RMW_IMPLEMENTATION=rmw_cyclonedds_cpp ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
USER 1001
WORKDIR /work
ENTRYPOINT ["bash", "/ws/run.bash"]
CMD ["--help"]

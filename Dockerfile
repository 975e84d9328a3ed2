# s2a-bench with the base install, on a CPU: loopback, HTTP, ROS 2 over Cyclone DDS (aarch64: Zenoh). docs/containers.md
# Not built yet: no builder was available. A test lints this file and runs its pip commands in a virtual environment.
FROM python:3.12-slim AS build
WORKDIR /src
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim
# extras of docs/install.md that need no compiler, as websocket,zmq
ARG EXTRAS=""
COPY constraints.txt /wheels/
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir -c /wheels/constraints.txt "$(ls /wheels/*.whl)${EXTRAS:+[$EXTRAS]}"
RUN useradd --create-home --uid 1000 s2a && install --directory --owner s2a /work
# DDS stays on the container's loopback
ENV ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
USER 1000
WORKDIR /work
ENTRYPOINT ["s2a-bench"]
CMD ["--help"]

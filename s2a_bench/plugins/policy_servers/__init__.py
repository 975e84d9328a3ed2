"""Policy servers: the transports and the dialect by which robots ask a policy for a chunk of actions."""

ACT = "the openvla dialect, /act"
GRPC = "policies over gRPC, as lerobot serves them"
WEBSOCKET = "policies over WebSocket, as openpi serves them"
ZMQ = "policies over ZeroMQ, as GR00T serves them"

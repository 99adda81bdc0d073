# docker build -t lagbench . && docker run --rm -v "$PWD/demo:/lagbench/demo" lagbench
FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates libx11-6 make python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /lagbench
COPY . .
RUN make .venv/.demo
CMD ["make", "demo"]

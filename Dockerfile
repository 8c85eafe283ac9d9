# magnet without anything else, on a CPU:    docker build -t magnet .
# or on an NVIDIA GPU:                       docker build -t magnet --build-arg TORCH=cu128 .
#
#     docker run --rm -v "$PWD:/data" magnet predict --task generation
#     docker run --rm --gpus all -v "$PWD:/data" magnet fit --config my.yaml
#     docker run --rm -p 8080:8080 -v "$PWD:/data" magnet view scene.npz --host 0.0.0.0 --port 8080
FROM python:3.12-slim

# Which build of torch: cpu, or a version of CUDA that the driver knows, such as cu126 or cu128. GPU builds bring CUDA
# themselves, so the image needs no other base.
ARG TORCH=cpu
ARG EXTRAS=view,video,hub

WORKDIR /srv/magnet
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY magnet magnet
RUN pip install --no-cache-dir uv \
 && uv pip install --system --no-cache --torch-backend ${TORCH} -c constraints.txt ".[${EXTRAS}]" \
 && magnet doctor \
 && python -m magnet.cli.all_answers --ship

RUN useradd --create-home magnet
USER magnet
WORKDIR /data
ENTRYPOINT ["magnet"]
CMD ["--help"]

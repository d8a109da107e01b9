# The commands of hoigs, without a GPU:
#   docker build -t hoigs . && docker run --rm -v "$PWD:/work" hoigs prepare my.mp4 --out clips/mine --yes
#   docker run --rm -v "$PWD:/work" -p 8090:8090 hoigs view runs/mine --host 0.0.0.0
# For a GPU: --build-arg TORCH_INDEX=https://pypi.org/simple, and run it with --gpus all.
FROM python:3.11-slim
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
COPY pyproject.toml constraints.txt README.md LICENSE /hoigs/
COPY hoigs /hoigs/hoigs
RUN pip install -c /hoigs/constraints.txt '/hoigs[prepare,view]' --extra-index-url "$TORCH_INDEX"
WORKDIR /work
ENTRYPOINT ["hoigs"]

# izoo in a container: docker build -t izoo .
# Building needs the package registries of Debian and Python, and nothing else from the network.
FROM python:3.11-slim

# What SUMO's packages link to and the slim image leaves out.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libatomic1 libexpat1 libgl1 libx11-6 libxext6 libxrender1 \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 izoo
WORKDIR /home/izoo/source
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 \
    OMP_WAIT_POLICY=PASSIVE \
    IZOO_CACHE_DIR=/home/izoo/.cache/izoo \
    NUMBA_CACHE_DIR=/home/izoo/.cache/numba

# PyTorch without CUDA is gigabytes smaller: --build-arg PIP_EXTRA_INDEX_URL=<PyTorch's index of CPU packages>
ARG PIP_EXTRA_INDEX_URL
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY izoo izoo
COPY envs envs
COPY algos algos
COPY benchmarks benchmarks
RUN pip install -c constraints.txt '.[osm,pettingzoo,tensorboard]'

USER izoo
# Compiles what would otherwise be compiled when the first environment starts, and shows that SUMO can be loaded.
RUN mkdir -p /home/izoo/.cache/izoo /home/izoo/.cache/numba /home/izoo/runs \
    && cd /home/izoo \
    && python -c "from izoo.envs import EcoDrivingEnv, EnvConfig; EcoDrivingEnv(config=EnvConfig(horizon_s=30.0)).rollout(4)"

WORKDIR /home/izoo
CMD ["python", "-m", "izoo.train", "--help"]

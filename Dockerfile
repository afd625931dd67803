# softgym-envs with all extras and the versions of requirements.lock, on the CPU. No image has been built from this file
# yet.
#
#   docker build -t softgym-envs .
#   docker run --rm -v "$PWD/results:/work/results" softgym-envs codesign --config finger_reach
FROM python:3.11-slim

# Libraries that the wheels of gmsh and vtk load.
RUN apt-get update && apt-get install -y --no-install-recommends \
        libegl1 libfontconfig1 libgl1 libglu1-mesa libgomp1 libx11-6 libxcursor1 libxext6 libxfixes3 libxft2 libxinerama1 \
        libxrender1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/softgym-envs
COPY requirements.lock .
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu -r requirements.lock
COPY . .
RUN pip install --no-cache-dir --no-deps --no-build-isolation .

WORKDIR /work
ENTRYPOINT ["softgym"]
CMD ["--help"]

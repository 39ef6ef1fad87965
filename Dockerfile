# PACE on a CPU: docker build -t pace . && docker run --rm -v "$PWD/runs:/work/runs" pace train minutes=3
FROM python:3.12-slim

# OpenGL without a display, for videos.
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libgles2 libgl1-mesa-dri && rm -rf /var/lib/apt/lists/*

# torch without CUDA, a tenth of the download, at the version of requirements.lock; then the other locked versions.
COPY requirements.lock /pace/
RUN pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu "$(grep -o '^torch==[0-9.]*' /pace/requirements.lock)" \
 && sed 's/ *\\$//; /^ *--hash/d; /^torch==/d' /pace/requirements.lock > /pace/versions.txt \
 && pip install --no-cache-dir --no-deps -r /pace/versions.txt

COPY . /pace
RUN pip install --no-cache-dir --no-deps /pace

WORKDIR /work
ENTRYPOINT ["pace"]
CMD ["train"]

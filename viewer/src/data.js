// The page's data: JSON with references into one compressed run of bytes (keepout/flights/pages/scene.py).

const KINDS = { float32: Float32Array, int8: Int8Array, int16: Int16Array, int32: Int32Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array };
const FORMAT = 1;

export async function read() {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  if (scene.format !== FORMAT) throw new Error(`the page's data are of format ${scene.format}; its viewer reads ${FORMAT}`);
  const text = atob(document.getElementById("content").textContent);
  const packed = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = await new Response(stream).arrayBuffer();
  const array = (reference) => unpack(bytes, reference);
  const { target } = scene;
  target.vertices = array(target.vertices);
  target.faces = array(target.faces);
  target.openness = array(target.openness);
  for (const surface of scene.surfaces)
    for (const name of ["vertices", "normals", "faces"]) surface[name] = array(surface[name]);
  for (const flight of scene.flights)
    for (const [name, reference] of Object.entries(flight.arrays)) flight[name] = array(reference);
  for (const { growth } of scene.flights.filter((flight) => flight.growth)) {
    for (const stage of growth.stages) for (const name of ["vertices", "faces"]) stage[name] = array(stage[name]);
    for (const [name, reference] of Object.entries(growth.views)) growth.views[name] = array(reference);
  }
  for (const { coverage } of scene.flights.filter((flight) => flight.coverage)) {
    for (const name of ["vertices", "faces", "fates", "firsts"]) coverage[name] = array(coverage[name]);
    for (const [name, reference] of Object.entries(coverage.frames)) coverage.frames[name] = array(reference);
  }
  return scene;
}

function unpack(bytes, { offset, type, shape, scale, origin }) {
  const count = shape.reduce((product, length) => product * length, 1);
  const stored = new KINDS[type](bytes, offset, count);
  if (scale === undefined) return stored;
  const columns = scale.length;
  return Float32Array.from(stored, (step, place) => origin[place % columns] + scale[place % columns] * step);
}

// Row whose time is the last one not after `time`, and the share of the way to the next.
export function rowAt(flight, time) {
  const times = flight.time;
  let low = 0;
  let high = times.length - 1;
  if (time >= times[high]) return [high, 0];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  return [low, Math.max(0, (time - times[low]) / (times[low + 1] - times[low]))];
}

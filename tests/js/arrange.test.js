/** The Drive view: the roles of the cameras, and a place for every picture. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { arrange, BIRDSEYE, isTopView, rolesOf } from "../../runner/page/static/arrange.js";
import { visible } from "../../runner/page/static/framing.js";

const camera = (name, yaw_deg = null, pitch_deg = 0, width = 1920, height = 1080) =>
  ({ name, width, height, framing: null, pose: yaw_deg === null ? null : { yaw_deg, pitch_deg } });

const named = (roles) => ({ ...Object.fromEntries(["front", "left", "right", "rear"].map((role) => [role, roles[role]?.name ?? null])), others: roles.others.map(({ name }) => name) });

/** The cameras of a packaged vehicle as the station describes them, from the project's own files. */
function packaged(vehicle) {
  const text = readFileSync(new URL(`../../conf/vehicle/${vehicle}.yaml`, import.meta.url), "utf8");
  const mounts = [...text.matchAll(/^ {2}- \/cameras@cameras\.(\w+): (\w+)/gm)];
  return mounts.map(([, name, kind]) => {
    const model = readFileSync(new URL(`../../conf/cameras/${kind}.yaml`, import.meta.url), "utf8");
    const [width, height] = ["width_px", "height_px"].map((key) => Number(model.match(new RegExp(`^${key}: (\\d+)`, "m"))[1]));
    const pose = text.slice(text.indexOf(`  ${name}:\n`)).match(/pose: \{(.*?)\}/)[1];
    const angle = (key) => Number(pose.match(new RegExp(`${key}: (-?[\\d.]+)`))?.[1] ?? 0);
    return camera(name, angle("yaw_deg"), angle("pitch_deg"), width, height);
  });
}

const VEHICLES = {
  tum_q7: packaged("tum_q7"),
  delivery_robot: packaged("delivery_robot"),
  "three in front": [camera("front", 0), camera("left", 50), camera("right", -50)],
  "one neighbour": [camera("front", 5), camera("left", 60), camera("rear", 180)],
  "one camera": [camera("front", 0)],
  "no poses": [camera("a"), camera("b"), camera("c")],
  "old 4:3 cameras": [["front", 0], ["left", 70], ["right", -70], ["rear", 180]].map(([name, yaw]) => camera(name, yaw, 0, 640, 480)).concat(camera("top", 0, 60, 640, 480)),
  "six top views": [camera("front", 0), camera("rear", 180), ...[1, 2, 3, 4, 5, 6].map((n) => camera(`top_${n}`, n * 60, 45))],
};
const DESKTOPS = [[1280, 720], [1366, 768], [1920, 1080], [2560, 1440], [3840, 2160], [1024, 768]];
const PHONE = [[412, 915], [915, 412]];
const OTHERS = [[768, 1024], [1508, 1080], [954, 768], [668, 768], [2560, 1080]]; // next to an open drawer, and very wide
const SIZES = [...DESKTOPS, ...PHONE, ...OTHERS];

const overlap = (a, b) => a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height;
const share = ({ width, height }, size) => (width * height) / (size[0] * size[1]);

/** The boxes of pictures and panels, after checking that they are inside the area and do not overlap. */
function checked({ pictures, panels }, [width, height]) {
  const boxes = [...pictures, ...Object.entries(panels)];
  for (const [name, box] of boxes) {
    assert.ok(box.x >= 0 && box.y >= 0 && box.x + box.width <= width && box.y + box.height <= height, `${name}: ${JSON.stringify(box)}`);
    assert.ok(Math.min(box.width, box.height) >= 40, `${name}: ${JSON.stringify(box)}`);
  }
  for (const [i, [name, box]] of boxes.entries())
    for (const [other, its] of boxes.slice(i + 1)) assert.ok(!overlap(box, its), `${name} and ${other}`);
  for (const name of ["figures", "messages", "words", "buttons"]) assert.ok(name in panels, name);
  return boxes;
}

test("the packaged vehicles are read", () => {
  assert.equal(VEHICLES.tum_q7.length, 8);
  assert.deepEqual(VEHICLES.delivery_robot.map(({ name, width, pose }) => [name, width, pose]), [
    ["front", 1280, { yaw_deg: 0, pitch_deg: 10 }], ["rear", 848, { yaw_deg: 180, pitch_deg: 10 }], ["mast", 1600, { yaw_deg: 0, pitch_deg: 40 }],
  ]);
});

for (const [vehicle, cameras] of Object.entries(VEHICLES))
  for (const size of SIZES) {
    const [width, height] = size;
    test(`${vehicle} at ${width}x${height}: every picture and panel has its place, and little of the area is unused`, () => {
      const arrangement = arrange(cameras, width, height);
      const { pictures } = arrangement;
      assert.deepEqual([...pictures.keys()].sort(), cameras.map(({ name }) => name).sort());
      const used = checked(arrangement, size).reduce((sum, [, box]) => sum + share(box, size), 0);
      const front = pictures.get(rolesOf(cameras).front.name);
      for (const [name, box] of pictures) assert.ok(box === front || share(box, size) <= share(front, size), name);
      if (DESKTOPS.includes(size)) assert.ok(share(front, size) >= 0.4, `front: ${share(front, size)}`);
      assert.ok(used >= (DESKTOPS.includes(size) ? 0.88 : 0.78), `used: ${used}`);
    });
  }

for (const size of [...DESKTOPS, ...PHONE])
  test(`the paper's vehicle at ${size.join("x")}: 95 % of the screen is used, and all pictures are whole`, () => {
    const arrangement = arrange(VEHICLES.tum_q7, size[0], size[1]);
    const used = checked(arrangement, size).reduce((sum, [, box]) => sum + share(box, size), 0);
    assert.ok(used >= 0.95, `used: ${used}`);
    for (const { name, width, height } of VEHICLES.tum_q7) {
      const { view, ...box } = arrangement.pictures.get(name);
      const seen = visible(box, { width, height }, view);
      assert.ok(seen.width > width - 1 && seen.height > height - 1, `${name}: cropped`);
      assert.ok(Math.abs(Math.log((box.width * height) / (box.height * width))) < 0.03, `${name}: bars at its edges`);
    }
  });

test("the front picture is as wide as a phone that is held upright", () => {
  assert.equal(arrange(VEHICLES.tum_q7, 412, 915).pictures.get("front_center").width, 412);
});

test("the paper's vehicle: neighbours at both sides, the rear view above, top views below each other", () => {
  assert.deepEqual(named(rolesOf(VEHICLES.tum_q7)), {
    front: "front_center", left: "front_left", right: "front_right", rear: "rear_center",
    others: ["top_front", "top_left", "top_right", "top_rear"],
  });
  const { pictures } = arrange(VEHICLES.tum_q7, 1920, 1080);
  const at = (name) => pictures.get(name);
  assert.ok(at("front_left").x < at("rear_center").x && at("rear_center").x < at("front_right").x);
  assert.ok(at("rear_center").y < at("front_center").y && at("front_center").x + at("front_center").width < at("top_left").x);
});

test("side and rear pictures are a strip as wide as the front picture", () => {
  const { pictures } = arrange(VEHICLES.tum_q7, 1920, 1080);
  const [left, rear, right, front] = ["front_left", "rear_center", "front_right", "front_center"].map((name) => pictures.get(name));
  assert.deepEqual([left.x, left.y, rear.y, right.y], [0, 0, 0, 0]);
  assert.ok(left.x + left.width <= rear.x && rear.x + rear.width <= right.x);
  assert.ok(Math.abs(right.x + right.width - front.width) <= 4);
});

test("places without a camera beside the mirror are for what a driver reads most often", () => {
  const { pictures, panels } = arrange(VEHICLES.delivery_robot, 1920, 1080);
  const mirror = pictures.get("rear");
  assert.ok(panels.figures.x + panels.figures.width <= mirror.x && mirror.x + mirror.width <= panels.messages.x);
});

test("a camera's picture may fill its box", () => {
  const cameras = VEHICLES.tum_q7.map((each) => ({ ...each, framing: { front_left: "fit", top_left: "fill" }[each.name] ?? null }));
  const { pictures } = arrange(cameras, 1920, 1080);
  const fit = (name) => pictures.get(name).view.fit;
  assert.deepEqual(["front_left", "front_right", "top_left", "top_right"].map(fit), ["contain", "contain", "cover", "contain"]);
});

test("only cameras that look backwards are mirrored, and no top view", () => {
  const { pictures } = arrange(VEHICLES.tum_q7, 1920, 1080);
  assert.deepEqual([...pictures].filter(([, { view }]) => view.mirrored).map(([name]) => name), ["rear_center"]);
});

test("angles wrap around in either direction", () => {
  const roles = rolesOf([camera("rear", -180), camera("left", 420), camera("right", 300), camera("front", 360)]);
  assert.deepEqual(named(roles), { front: "front", left: "left", right: "right", rear: "rear", others: [] });
});

test("the front camera is the one nearest to straight ahead, within 30 degrees", () => {
  assert.equal(rolesOf([camera("a", 20), camera("b", -10), camera("top", 0, 40)]).front.name, "b");
});

test("otherwise it is the first one that looks forward, otherwise the first", () => {
  assert.equal(rolesOf([camera("rear", 180), camera("a", 60), camera("b", -40)]).front.name, "a");
  assert.equal(rolesOf([camera("top", 0, 60), camera("rear", 180)]).front.name, "top");
  assert.equal(rolesOf([camera("x"), camera("y")]).front.name, "x");
});

test("a second rear view is in the row, mirrored too", () => {
  const cameras = [camera("front", 0), camera("rear", 180), camera("rear_left", 150)];
  assert.deepEqual(named(rolesOf(cameras)).others, ["rear_left"]);
  assert.equal(arrange(cameras, 1920, 1080).pictures.get("rear_left").view.mirrored, true);
});

test("a camera may be swapped with the front camera; both are shown whole", () => {
  const before = arrange(VEHICLES.tum_q7, 1920, 1080).pictures;
  const after = arrange(VEHICLES.tum_q7, 1920, 1080, "rear_center").pictures;
  const place = ({ x, y, width, height }) => [x, y, width, height];
  assert.deepEqual(place(after.get("rear_center")), place(before.get("front_center")));
  assert.deepEqual(place(after.get("front_center")), place(before.get("rear_center")));
  assert.equal(after.get("rear_center").view.mirrored, true);
  assert.equal(after.get("front_center").view.mirrored, false);
  assert.equal(arrange(VEHICLES.tum_q7, 1920, 1080, "front_left").pictures.get("front_left").view.fit, "contain");
});

const ABOVE = { width: 18, height: 21 };

for (const vehicle of ["tum_q7", "delivery_robot", "six top views"])
  for (const size of SIZES)
    test(`${vehicle} at ${size.join("x")}: a bird's-eye view replaces the top views, and overlaps nothing`, () => {
      const cameras = VEHICLES[vehicle];
      const arrangement = arrange(cameras, size[0], size[1], null, ABOVE);
      const { pictures } = arrangement;
      assert.deepEqual([...pictures.keys()].sort(), [...cameras.filter((each) => !isTopView(each)).map(({ name }) => name), BIRDSEYE].sort());
      checked(arrangement, size);
      const [front, above] = [pictures.get(rolesOf(cameras).front.name), pictures.get(BIRDSEYE)];
      if (DESKTOPS.includes(size)) assert.ok(share(front, size) >= 0.4, `front: ${share(front, size)}`);
      assert.ok(Math.abs(above.width / above.height - 18 / 21) < 0.02, JSON.stringify(above));
    });

test("a bird's-eye view is at least 500 px high beside the front picture, which it leaves where it is", () => {
  const [without, beside] = [null, ABOVE].map((above) => arrange(VEHICLES.tum_q7, 1920, 1080, null, above).pictures);
  assert.ok(beside.get(BIRDSEYE).height >= 500, JSON.stringify(beside.get(BIRDSEYE)));
  for (const name of ["front_center", "front_left", "rear_center"]) assert.deepEqual(beside.get(name), without.get(name));
});

test("a place is where its picture is, or would be", () => {
  const { pictures, slots } = arrange(VEHICLES["one neighbour"], 1920, 1080);
  assert.deepEqual([slots.front, slots.left, slots.rear], ["front", "left", "rear"].map((name) => pictures.get(name)));
  assert.ok(slots.right.x > slots.rear.x && slots.row.x >= slots.front.width);
});

test("the bird's-eye view may be swapped with the front camera, and so may a top view next to it", () => {
  const large = arrange(VEHICLES.tum_q7, 1920, 1080, BIRDSEYE, ABOVE).pictures;
  const usual = arrange(VEHICLES.tum_q7, 1920, 1080, null, ABOVE).pictures;
  assert.deepEqual([large.get(BIRDSEYE).width, large.get("front_center").width], [usual.get("front_center").width, usual.get(BIRDSEYE).width]);
  const beside = arrange(VEHICLES.tum_q7, 1920, 1080, "top_left", ABOVE).pictures;
  assert.ok(beside.has(BIRDSEYE) && !beside.has("top_right"));
  assert.ok(beside.get("top_left").width > beside.get("front_center").width);
});

test("no cameras, no pictures", () => assert.equal(arrange([], 1920, 1080).pictures.size, 0));

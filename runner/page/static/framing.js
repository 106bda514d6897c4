/** How a picture is placed in its box on the screen: whole or cropped, mirrored or not. Pure; lengths in px. */

/**
 * @typedef {object} View
 * @property {"contain"|"cover"} fit the whole picture, or the whole box
 * @property {boolean} mirrored left and right are swapped on the screen
 * @typedef {{width: number, height: number}} Size
 * @typedef {{x: number, y: number, width: number, height: number}} Rectangle
 */

/** @type {View} */
export const WHOLE = { fit: "contain", mirrored: false };

/**
 * The picture's rectangle, in px of the box; larger than the box where the picture is cropped.
 * @param {Size} box  @param {Size} picture  @param {View} view
 */
export function placement(box, picture, { fit }) {
  const ratios = [box.width / picture.width, box.height / picture.height];
  const scale = fit === "cover" ? Math.max(...ratios) : Math.min(...ratios);
  const width = picture.width * scale;
  const height = picture.height * scale;
  return { scale, x: (box.width - width) / 2, y: (box.height - height) / 2, width, height };
}

/**
 * The point of the picture that a point of the box shows.
 * @param {{x: number, y: number}} point  @param {Size} box  @param {Size} picture  @param {View} view
 */
export function toPicture(point, box, picture, view) {
  const { scale, x, y } = placement(box, picture, view);
  const across = (point.x - x) / scale;
  return { x: view.mirrored ? picture.width - across : across, y: (point.y - y) / scale };
}

/**
 * Where a rectangle of the picture is shown in the box.
 * @param {Rectangle} part  @param {Size} box  @param {Size} picture  @param {View} view
 */
export function toBox(part, box, picture, view) {
  const { scale, x, y } = placement(box, picture, view);
  const left = view.mirrored ? picture.width - part.x - part.width : part.x;
  return { x: x + left * scale, y: y + part.y * scale, width: part.width * scale, height: part.height * scale };
}

/**
 * A function from a point of the full image to where it is shown in the box.
 * @param {Size} box  @param {Size} picture  @param {View} view  @param {Rectangle} region of the full image that the picture shows
 */
export function imageToBox(box, picture, view, region) {
  const { scale, x, y } = placement(box, picture, view);
  const [across, down] = [picture.width / region.width, picture.height / region.height];
  return (point) => {
    const right = (point.x - region.x) * across;
    return { x: x + scale * (view.mirrored ? picture.width - right : right), y: y + scale * (point.y - region.y) * down };
  };
}

/**
 * States which part of the picture is shown, and whether mirrored; "" for a whole picture that is not mirrored.
 * @param {Size} box  @param {Size} picture  @param {View} view
 */
export function framingText(box, picture, view) {
  const { width, height } = visible(box, picture, view);
  const percent = Math.round((100 * width) / picture.width);
  const across = width < 0.995 * picture.width ? `middle ${percent} % shown` : "";
  const down = height < 0.995 * picture.height ? `middle ${Math.round((100 * height) / picture.height)} % of the height shown` : "";
  return [across, down, view.mirrored ? "mirrored" : ""].filter(Boolean).join(", ");
}

/**
 * The part of the picture that is shown.
 * @param {Size} box  @param {Size} picture  @param {View} view
 */
export function visible(box, picture, view) {
  const { scale } = placement(box, picture, view);
  const width = Math.min(picture.width, box.width / scale);
  const height = Math.min(picture.height, box.height / scale);
  return { x: (picture.width - width) / 2, y: (picture.height - height) / 2, width, height };
}
